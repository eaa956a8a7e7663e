"""Published methods that our own comparison found no use for, with the hooks that only they need (docs/what_helps.md)."""
