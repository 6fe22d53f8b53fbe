"""Example programs that use the package; run one from the source tree with ``python -m examples.NAME``."""
