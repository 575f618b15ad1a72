"""Tables, figures, texts and pages of the results."""
