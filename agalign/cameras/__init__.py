"""Camera files: their tags, one module per maker, and the captures below a folder."""
