"""The verbs of the command line: each module has ``add_parser(subparsers)`` and ``run(args) -> int``.

Verbs import what they compute with inside ``run``, so that ``hexapod_comp --help`` needs no NumPy.
"""
