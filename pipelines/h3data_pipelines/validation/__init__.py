"""Detection of faults of recordings (`h3data validate`) and of scenes (`h3data scenes validate`).

- `recordings`: columns, time, values, the hash, jumps, feet, walls; `penetration`: agents inside each other or furniture
- `scenes`: floor that is cut off, passages too narrow, floating objects, receptacles out of reach
"""
