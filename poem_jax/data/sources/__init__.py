"""One file a data set: its files and conventions, and nobody after it knows them."""
