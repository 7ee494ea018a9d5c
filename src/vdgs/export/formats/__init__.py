"""Standard files of Gaussians and of points, one format a file; `registry` knows them by their endings."""
