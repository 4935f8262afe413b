"""Between images: cameras, networks, bundle adjustment, resection, forward intersection, measuring bodies."""
