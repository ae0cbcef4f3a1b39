<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<!-- echo_width of a cloud of wavebatch, for point cloud layers of QGIS 3.32 or later. No-data (-9999) is not drawn. -->
<qgis styleCategories="Symbology" version="3.32.0">
  <renderer type="ramp" attribute="echo_width" min="3" max="10" pointSize="1" pointSizeUnit="MM">
    <colorrampshader colorRampType="INTERPOLATED" classificationMode="1" clip="1" minimumValue="3" maximumValue="10">
      <item label="less" value="-9998" color="#440154" alpha="255"/>
      <item label="3" value="3" color="#440154" alpha="255"/>
      <item label="4.75" value="4.75" color="#3b528b" alpha="255"/>
      <item label="6.5" value="6.5" color="#21918c" alpha="255"/>
      <item label="8.25" value="8.25" color="#5ec962" alpha="255"/>
      <item label="10" value="10" color="#fde725" alpha="255"/>
      <item label="more" value="1000000000" color="#fde725" alpha="255"/>
      <rampLegendSettings useContinuousLegend="0"/>
    </colorrampshader>
  </renderer>
</qgis>
