"""Linear algebra of small matrices, trees of arrays, and least squares."""
