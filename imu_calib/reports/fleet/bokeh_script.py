"""The library that draws: its script, as it comes in its wheel."""

from __future__ import annotations

from ...extras import require


def bokeh_script() -> str:
    """Return the script, which an HTML file can hold.

    Raises:
        InputError: Bokeh is not installed.

    """
    require('bokeh', 'A page on a catalogue', 'fleet')
    from bokeh.resources import Resources

    # The last of these sets what it says on the browser's console, and says so there.
    library, plotting, *_ = Resources(mode='inline', components=['bokeh', 'bokeh-api']).js_raw
    script = f'{library}\n{plotting}\nBokeh.logger.set_level("error");'
    return script.replace('</script', r'<\/script')
