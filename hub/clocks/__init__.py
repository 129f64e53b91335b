"""Camera clocks over time: segments, step and rate-change detection, external priors."""
