"""Commands for Monte-Carlo studies, and for pictures of them."""
