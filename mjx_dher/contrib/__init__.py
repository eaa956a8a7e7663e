"""Published methods that did not help in our comparison, with the hooks that only they need (docs/what_helps.md)."""
