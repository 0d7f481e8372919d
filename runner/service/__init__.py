"""The service: an HTTP API and pages over the same functions as the commands.

    from pathlib import Path
    from runner.service.app import create_app
    from runner.service.settings import ServiceSettings

    app = create_app(ServiceSettings(recordings=(Path("recordings"),)))  # for any ASGI server

`dualtaxi serve` runs it, with limits on slow clients and a graceful stop (`runner.service.server`).
"""
