"""A backend of matplotlib's that has windows without a display: it counts what they show."""

from matplotlib.backend_bases import FigureManagerBase
from matplotlib.backends.backend_agg import FigureCanvasAgg

shown = []


class FigureManager(FigureManagerBase):
    @classmethod
    def start_main_loop(cls):
        pass

    @classmethod
    def pyplot_show(cls, *, block=None):
        from matplotlib._pylab_helpers import Gcf

        for manager in Gcf.get_all_fig_managers():
            manager.canvas.draw()
            shown.append(bytes(manager.canvas.buffer_rgba()))


class FigureCanvas(FigureCanvasAgg):
    manager_class = FigureManager
    # As matplotlib calls what runs where there is no display.
    required_interactive_framework = "headless"

    def start_event_loop(self, timeout=0):
        pass
