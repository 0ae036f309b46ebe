"""Commands that show recordings.

`rerender` writes videos and images from any camera (`rendering` is its frame loop), `viewing` Rerun files, `report` HTML.
"""
