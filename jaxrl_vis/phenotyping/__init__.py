"""Stalks from stereo images (chapter 3 of the thesis): how many stand in a plot, and how thick they are, in millimetres.

    synth        folders of synthetic pairs with truth      calibration    what is known of the cameras, from files
    width        width of a stalk's mask, in pixels         stereo         disparity inside detections
    metric       pixels and disparities to millimetres      annotations    COCO

An application with requirements of its own, the extra ``phenotyping``. Nothing else of this project imports it.
"""
