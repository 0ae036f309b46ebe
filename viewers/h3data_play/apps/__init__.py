"""Built-in apps for live play: rearrangement, following, tele-operation and tutorial."""
