"""Tables, figures, words, videos and the page: what is shown of results that are there."""
