"""Commands that learn parameters by gradient."""
