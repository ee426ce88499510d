"""Run Monte-Carlo studies: a labelled grid times trials, its measurements and their store."""
