"""The service on several machines: gateways, orchestrator and slots, actors of a Ray cluster."""
