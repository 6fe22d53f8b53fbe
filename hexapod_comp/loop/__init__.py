"""Code of the verbs ``run`` (a session with the nodes) and ``demo`` (a demonstration without nodes)."""
