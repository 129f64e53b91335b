"""Detection networks in ONNX files: their description, their runtimes, and what their outputs mean."""
