"""Integration with Ray Serve, uvicorn and HAProxy, including all uses of their internals."""
