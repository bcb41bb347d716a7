"""What artists see: panels, operators, results in the Image Editor, preferences."""
