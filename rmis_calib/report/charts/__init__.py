"""Charts of a report: signed residuals, and results of one set-up over its recordings."""
