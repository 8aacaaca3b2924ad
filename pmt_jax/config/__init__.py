"""What can be chosen: settings (static and traced), the table of methods, TOML in and out.

Imports `errors` and `tasks` only."""
