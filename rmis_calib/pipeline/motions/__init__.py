"""Which shaft of each picture is the instrument: the observations that the solver takes."""
