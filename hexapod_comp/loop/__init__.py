"""Sessions of compensator and virtual machine: ``run`` starts both as nodes, ``demo`` runs a demonstration."""
