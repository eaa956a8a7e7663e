"""Published methods that claim to improve on `future`, each a short function; docs/samplers.md has their formulas."""
