"""What the work costs, beside what a user would pick for it: one section a module, one row a comparison."""
