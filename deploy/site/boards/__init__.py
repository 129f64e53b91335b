"""Many boards of one site: keys made on the board, configurations from one file, staged updates with rollback."""
