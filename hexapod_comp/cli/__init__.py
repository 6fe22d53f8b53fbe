# PYTHON_ARGCOMPLETE_OK
"""The command ``hexapod_comp <verb>``: app.py runs a verb, verbs.py lists all verbs."""

from .app import main as main
from .app import make_parser as make_parser
