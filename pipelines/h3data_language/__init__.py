"""Tasks in words, with instructions, propositions, their evaluation, and experts that carry them out."""
