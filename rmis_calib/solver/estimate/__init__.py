"""The joint estimate: starts compete, outliers leave, noise levels settle, and the bias is subtracted."""
