from .server import PolicyServer as PolicyServer
