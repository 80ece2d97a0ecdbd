"""The paper's studies as grids, and what its numbers and sentences look like beside ours. Never imports JAX."""
