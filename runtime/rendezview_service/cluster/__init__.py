"""The service on several machines: gateways, a steward and seats, as actors of a Ray cluster."""
