"""What draws figures in a browser: Vega, Vega-Lite and vega-embed as one script.

To bundle it takes two seconds, so it is kept among the user's caches.
"""

import contextlib
from functools import cache
from importlib.metadata import version
from pathlib import Path

from osel_sim.core.caches import prepare
from osel_sim.core.files import atomic

_BEGIN, _END = "(() => {", "})();"


@cache
def vega_script() -> str:
    """The script, as vl-convert brings it. It defines `vegaEmbed` and nothing else, hence the function around it."""
    import vl_convert

    file = prepare() / "osel_sim" / f"vega_{version('vl-convert-python')}.js"
    script = _kept(file)
    if script is None:
        bundle = vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;")
        script = f"{_BEGIN}{bundle}{_END}".replace("</script", "<\\/script")
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic(file, shared=True) as partial:
                partial.write_bytes(script.encode())
    return script


def _kept(file: Path) -> str | None:
    """What was kept, if it is whole."""
    try:
        script = file.read_bytes().decode()
    except (OSError, UnicodeDecodeError):
        return None
    return script if script.startswith(_BEGIN) and script.endswith(_END) and "</script" not in script else None
