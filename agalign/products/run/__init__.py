"""Files of a whole run: record, excluded captures, map of footprints; and its captures as input of other products."""
