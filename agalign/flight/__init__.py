"""What the captures of a flight have in common: how they are grouped, and the model that they share."""
