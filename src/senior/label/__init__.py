"""People as teachers: clips of what is asked about, a page to answer on, and its server. Nothing here imports JAX."""
