"""Human-in-the-loop sessions in a browser, live.

A front process (`front`) holds sockets and seats and imports neither NumPy nor numba; workers (`worker`) step many worlds
each (`live`), 30 times a second, over `sim_kinematic.tasks.runner.Session`. h3data docs play has the protocol.
"""
