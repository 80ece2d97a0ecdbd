"""The policy and its critics: pure functions of one run."""
