"""Monte-Carlo studies: a labelled grid times trials, what is measured, how it is kept."""
