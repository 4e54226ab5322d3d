"""Point clouds: messages to points, filters, neighbours, local shape."""
