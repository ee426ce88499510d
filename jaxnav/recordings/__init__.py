"""Record jaxnav's drives, read them back and replay them."""
