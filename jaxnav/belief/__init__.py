"""Which candidate to take, and what is believed after it."""
