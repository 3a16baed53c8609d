"""What a run leaves behind: the picture as EXR and PNG, the report, progress on the terminal."""
