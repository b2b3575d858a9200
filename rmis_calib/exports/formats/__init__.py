"""One module a format: an answer in, the text of a file (or of the files of a folder) out. Nothing is written here."""
