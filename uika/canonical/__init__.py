"""The canonical head surface as splats, and the colours supposed where no photo looked."""
