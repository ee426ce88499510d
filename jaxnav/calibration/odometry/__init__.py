"""What wheels and steering get wrong, from drives past markers."""
