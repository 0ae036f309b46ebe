"""Mixed models, marginal means, contrasts, intervals: arrays in, numbers out."""
