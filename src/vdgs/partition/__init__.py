"""The scene cut into blocks by place and visibility, and the cameras that train each (section IV-B)."""
