"""Many runs, on this machine or on a Ray cluster. Never imports JAX: the workers do."""
