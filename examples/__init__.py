"""Programs that use the package; run from the source tree by ``python -m examples.NAME``."""
