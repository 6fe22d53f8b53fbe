"""What the verbs ``run`` and ``demo`` do: a session with the nodes, and a demonstration without nodes."""
