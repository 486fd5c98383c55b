"""Many runs' octrees as one map, tile by tile, so that it need not fit into one machine's memory."""
