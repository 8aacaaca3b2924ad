"""What a trained team is used for: loading, evaluating, exporting, the pretrained hub.

Imports `training` and what lies below it."""
