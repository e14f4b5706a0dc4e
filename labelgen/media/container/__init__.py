"""What a video container says of its frames: stamps and clocks, geometry, tracks, key frames, damage."""
