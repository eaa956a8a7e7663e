"""The viewer in the browser (extra `view`): what plays, what is shown of it, and the server."""
