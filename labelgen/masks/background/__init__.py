"""Instance masks by background subtraction: model, foreground, silhouettes."""
