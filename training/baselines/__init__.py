"""Other methods in the tables: DeepVO, pose graphs, KISS-ICP."""
