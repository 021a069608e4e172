"""The road of the fault search: `light_road.LightRoad`, its entrances and vehicles."""
