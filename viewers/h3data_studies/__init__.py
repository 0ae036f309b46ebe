"""Studies in which people take part in a browser, from consent to completion code.

`design` has the contents of a study file, `flow` the order of a participant's stages, `store` the progress of
participants (SQLite), and `front` the server. None of these imports NumPy or the simulator. `files` reads and checks a
study file and plans the episodes of participants; it imports them and runs in the command that starts the server.
"""
