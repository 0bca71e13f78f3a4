"""What a run publishes: pages, formats of other programs, the history of a campaign."""
