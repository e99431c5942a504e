"""The viewer in the browser: `mjx-arm view`. It needs the extra `view`. Nothing imports it."""
