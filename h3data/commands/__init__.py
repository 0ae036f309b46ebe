"""What commands are made of: options, results, care with output files."""
