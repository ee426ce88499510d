"""Commands that simulate cars."""
