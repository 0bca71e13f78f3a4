"""Files to recordings: units and axes end here."""
