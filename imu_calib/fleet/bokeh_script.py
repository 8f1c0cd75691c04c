"""The script of Bokeh from its wheel."""

from __future__ import annotations

from ..common.files import require


def bokeh_script() -> str:
    """Return the script in a form that an HTML file can contain.

    Raises:
        InputError: Bokeh is not installed.
    """
    require('bokeh', 'A page on a catalogue', 'fleet')
    from bokeh.resources import Resources

    # The last of these sets the log level, and reports it on the browser's console.
    library, plotting, *_ = Resources(mode='inline', components=['bokeh', 'bokeh-api']).js_raw
    script = f'{library}\n{plotting}\nBokeh.logger.set_level("error");'
    return script.replace('</script', r'<\/script')
