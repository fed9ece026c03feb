"""Why boxes are missed, false or badly placed: errors by view, distance, occlusion and points, and pictures of them."""
