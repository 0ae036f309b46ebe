"""Tasks in words: instructions with propositions, their evaluation from recordings, and experts that carry them out."""
