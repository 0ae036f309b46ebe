"""What recordings show: names of assets, the meshes that they mean, and what stands in for those that are not there."""
