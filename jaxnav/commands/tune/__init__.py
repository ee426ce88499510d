"""Parameters learned by gradient."""
