"""One capture: its bands beside the reference, where each starts, and what comes of it."""
