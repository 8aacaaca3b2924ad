"""What can be chosen: settings (static and traced), the table of methods, and where settings come from.

Imports `errors` and `tasks` only."""
