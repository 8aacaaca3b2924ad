"""Two Shadow hands hand an object over (ShadowHandOver): models and task."""
