"""From result files to figures. Reads files only and never imports JAX."""
