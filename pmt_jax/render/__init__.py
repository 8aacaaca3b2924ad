"""Pictures: episodes as films and pages, reports.

Imports `studies` and what lies below it."""
