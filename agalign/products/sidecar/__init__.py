"""The sidecar of a capture: its schema, values and file."""
