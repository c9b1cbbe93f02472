"""Parts of the GPU validation. Each is a module with `measure(options)`, a generator of rows."""
