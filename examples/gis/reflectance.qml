<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<!-- reflectance of a cloud of wavebatch, for point cloud layers of QGIS 3.32 or later. No-data (-9999) is not drawn. -->
<qgis styleCategories="Symbology" version="3.32.0">
  <renderer type="ramp" attribute="reflectance" min="0" max="1" pointSize="1" pointSizeUnit="MM">
    <colorrampshader colorRampType="INTERPOLATED" classificationMode="1" clip="1" minimumValue="0" maximumValue="1">
      <item label="less" value="-9998" color="#440154" alpha="255"/>
      <item label="0" value="0" color="#440154" alpha="255"/>
      <item label="0.25" value="0.25" color="#3b528b" alpha="255"/>
      <item label="0.5" value="0.5" color="#21918c" alpha="255"/>
      <item label="0.75" value="0.75" color="#5ec962" alpha="255"/>
      <item label="1" value="1" color="#fde725" alpha="255"/>
      <item label="more" value="1000000000" color="#fde725" alpha="255"/>
      <rampLegendSettings useContinuousLegend="0"/>
    </colorrampshader>
  </renderer>
</qgis>
