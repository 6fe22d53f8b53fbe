"""The compensator and the virtual machine run together: what ``demo`` and ``run`` do."""
