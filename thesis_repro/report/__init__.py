"""Tables, figures, texts, videos and pages of the results."""
