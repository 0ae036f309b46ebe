"""People who choose their velocities among others: social force and reciprocal avoidance over one home's distance grid."""
