"""Pictures for people: what was found, and what each stage of the search saw."""
