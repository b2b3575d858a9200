"""From observations to the answer, with frames, units, a status and advice."""
