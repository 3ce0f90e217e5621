"""A short scenario, a text that would be markup, and hands on the page of a replay in a browser."""

HOSTILE = "</script><script>document.title='owned'</script><img src=x onerror=alert(1)>&\"'\u2028"
SCENARIO = {
    "about": "Short, for tests.", "plant": {"name": "car_following", "gap": 20.0}, "sensor": "odometry", "controller": "acc", "horizon": 40,
    "manoeuvre": {"name": "braking", "onset": [0.0, 1.0]},
    "threat_model": {
        "kinds": ["dos_jam", "dos_hold", "dropout", "fdi"], "onset": 3, "budget": 30,
        "targets": ["position", "velocity", "leader_position", "acceleration"],
    },
}  # fmt: skip


def text_of(tab, element):
    return tab.find_element("id", element).text


def to(tab, step):
    tab.execute_script("const s = document.getElementById('slider'); s.value = arguments[0]; s.dispatchEvent(new Event('input'))", step)
