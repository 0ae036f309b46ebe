"""Evaluation of propositions from recordings, with PARTNR's percent complete, success and their explanation."""
