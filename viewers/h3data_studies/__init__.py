"""Studies: people who take part in a browser, from consent to completion code.

`design` holds what a study file says, `flow` the order of what a participant does, `store` who has done what (SQLite), `front`
the server. None of these imports NumPy or the simulator; `files` (reading and checking a study file, planning who plays what)
does, and runs in the command that starts the server.
"""
