"""Tasks told in words: instructions with propositions, their evaluation from recordings, experts that carry them out."""
