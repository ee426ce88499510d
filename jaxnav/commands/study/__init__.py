"""Monte-Carlo studies, and pictures of them."""
