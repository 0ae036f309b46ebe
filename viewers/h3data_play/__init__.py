"""Human-in-the-loop sessions that people play live in a browser.

A front process (`front`) serves sockets and seats and imports neither NumPy nor numba. Workers (`worker`) step many
worlds each (`live`), 30 times a second, with `sim_kinematic.tasks.sessions.Session`. ``h3data docs play`` describes the
protocol.
"""
