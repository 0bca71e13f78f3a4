"""What users start: commands, the configuration of campaigns, the steps of a run, and its results folder."""
