"""Viewer in the browser (extra `view`): player, scene, panel and server."""
