"""Who does the work of a job: processes of this machine, or a Ray cluster. Shards in, results out, in their order."""
