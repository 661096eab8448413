"""Draw a QGIS project without a screen, with the system's Python: ``render_qgis.py PROJECT PICTURE``.

It prints what QGIS says of the project, as JSON: system, layers, and the ground that the picture shows.
"""

import json
import sys
import xml.etree.ElementTree as ET

from qgis.core import (
    QgsApplication,
    QgsMapRendererSequentialJob,
    QgsMapSettings,
    QgsProject,
    QgsRectangle,
)
from qgis.PyQt.QtCore import QSize


def main() -> None:
    """Draw and print."""
    path, picture = sys.argv[1:]
    application = QgsApplication([], False)
    application.initQgis()
    project = QgsProject.instance()
    is_read = project.read(path)
    stated = ET.parse(path).find("mapcanvas/extent")
    assert stated is not None
    edges = [float(stated.findtext(edge)) for edge in ("xmin", "ymin", "xmax", "ymax")]
    settings = QgsMapSettings()
    settings.setDestinationCrs(project.crs())
    settings.setLayers(project.layerTreeRoot().layerOrder())
    settings.setOutputSize(QSize(3200, 2000))
    settings.setOutputDpi(300)  # strokes are some pixels wide
    settings.setExtent(QgsRectangle(*edges))
    job = QgsMapRendererSequentialJob(settings)
    job.start()
    job.waitForFinished()
    job.renderedImage().save(picture)
    shown = settings.visibleExtent()
    layers = {
        layer.name(): layer.isValid() and layer.crs().isValid() for layer in project.mapLayers().values()
    }
    about = {
        "read": is_read,
        "crs": project.crs().isValid(),
        "metres": project.crs().mapUnits() == 0,  # Qgis.DistanceUnit.Meters
        "layers": layers,
        "errors": [error.message for error in job.errors()],
        "shown": [shown.xMinimum(), shown.yMinimum(), shown.xMaximum(), shown.yMaximum()],
    }
    print(json.dumps(about))
    sys.stdout.flush()


if __name__ == "__main__":
    main()
