"""A vmap whose lanes lie last: what simulation and tuning run thousands of drives by."""
