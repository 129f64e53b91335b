"""Detection in whole videos: one detector over one file, its result, and a copy with overlays."""
