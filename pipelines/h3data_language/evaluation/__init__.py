"""Evaluation of propositions from recordings: PARTNR's percent complete, success and their explanation."""
