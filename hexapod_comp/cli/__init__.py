# PYTHON_ARGCOMPLETE_OK
"""The command ``hexapod_comp <verb>``: app.py runs a verb, verbs.py lists the verbs, other modules contain them."""

from .app import main as main
from .app import make_parser as make_parser
